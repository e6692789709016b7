"""How fast the parts are, each against a reference measured in the same run: `python -m benchmarks`."""
