"""Plots of flights as PNG: the first flights (`flights.draw`), the errors of all flights over time (`errors.draw`), and
settle times over the start's tilt and speed (`settle.draw`).

Errors are those of `measures`, tolerances those of the task. `figure` returns what `draw` saves; both use matplotlib's
objects without pyplot, so no global state is left.
"""
