"""data_synth: volumes with a known truth, rendered to posed image sets. Imports nothing from nerfvol."""

__version__ = "0.1.0"
