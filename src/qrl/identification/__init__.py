"""From flight logs to a vehicle: logs, a model with free parameters, its fit with intervals, held-out errors."""
