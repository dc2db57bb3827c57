"""The page of figures, flights and tables, and the browser that takes its pictures."""
