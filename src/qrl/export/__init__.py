"""A policy as a microcontroller kernel: quantise -> integer reference -> C -> proof.  NumPy alone."""
