"""The organ condensed once, and cuts and blades that move in it."""
