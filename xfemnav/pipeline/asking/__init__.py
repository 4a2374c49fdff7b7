"""What a run is asked: scenario, flags, what each stage reads."""
