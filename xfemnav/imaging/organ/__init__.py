"""Find the organ, what is taken out of it, and its outline."""
