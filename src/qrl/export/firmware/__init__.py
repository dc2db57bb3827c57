"""What stands around a kernel in a firmware: inputs from its estimator and set-point, outputs to its motors.

One module for each firmware, with the same functions: `refusal` says why a policy cannot fly there, `files` what is
written, `section` what report.md says; `vehicle` has what they share.
"""
