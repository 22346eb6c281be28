"""What people look at: result directories, tables, verdicts in words, pictures, reports. Nothing is inferred here."""
