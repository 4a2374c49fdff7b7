"""A scene known in closed form, through every format and frame."""
