"""What splats begin from: points of a structure-from-motion model, a plane sweep over the photographs, or random points."""
