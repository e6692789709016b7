"""Scenarios: every parameter of a run, as frozen types that a TOML file is decoded into."""
