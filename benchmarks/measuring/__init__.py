"""What measurements share: errors, operation counts, times, the machine they ran on, and results as written."""
