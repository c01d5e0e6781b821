"""Settings: what a value may be, and defaults < YAML file < command line."""
