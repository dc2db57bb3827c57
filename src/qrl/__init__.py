"""qrl: from a vehicle and a task to a policy that flies. Imports nothing; see the modules."""
