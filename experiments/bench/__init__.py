"""Timings of qrl beside other trainers and simulators."""
