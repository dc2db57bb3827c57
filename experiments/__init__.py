"""The runs: benchmarks, figures, gallery, profiles."""
