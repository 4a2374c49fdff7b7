"""Images and all that goes with them through the motion of the tissue."""
