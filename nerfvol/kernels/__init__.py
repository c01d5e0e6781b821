"""The operators on octrees and splats, compiled or in plain torch, and the plain data that they work on."""
