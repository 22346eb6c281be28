"""What tests share: cases with known answers, models, walks and checks. Nothing is imported from a test file."""
