"""Plots of flights as PNG: the first flights, the errors of all over time, and settle times over the start.

Errors are those of `measures`, tolerances those of the task. `figure` returns what `draw` saves, without pyplot.
"""
