"""What studies and tests compare with: other programs, and models written once more in plain numpy."""
