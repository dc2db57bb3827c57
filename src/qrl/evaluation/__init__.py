"""A trained run, loaded once for every command that flies it; evaluation starts, baselines, calibration."""
