"""Search over controller settings."""
