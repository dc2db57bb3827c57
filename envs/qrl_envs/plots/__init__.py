"""Pictures of flights as PNG: a few of them in full (`flights.draw`), the errors of all of them (`errors.draw`), and
how soon they settle by how they began (`settle.draw`).

What is measured is what measures.py measures, and every tolerance drawn is the task's. A figure is made apart
from being saved, of matplotlib's objects alone: no pyplot, so no state is left behind.
"""
