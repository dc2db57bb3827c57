"""The run folder: config.json, metrics, checkpoints, TensorBoard events and plots."""
