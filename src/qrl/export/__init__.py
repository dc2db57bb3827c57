"""A policy as a microcontroller kernel: quantize -> integer reference -> C -> verification. NumPy alone."""
