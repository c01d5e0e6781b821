"""What a representation begins from: one file each."""
