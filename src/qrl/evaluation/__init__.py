"""A trained run, loaded once for all who fly it."""
