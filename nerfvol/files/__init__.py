"""Reading and writing: atomic files, arrays, checkpoints, pictures, and what lies where in a run folder."""
