"""Many runs from one grid file."""
