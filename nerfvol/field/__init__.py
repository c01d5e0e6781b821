"""The neural field: encodings, networks, occupancy, samples along rays."""
