"""Where the time goes, and long runs."""
