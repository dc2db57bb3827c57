"""One run: compiled programs, devices, and the loop on the host."""
