"""The ``nerfvol`` command: one file a command."""
