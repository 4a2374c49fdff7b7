"""What a run says of itself: verdicts, report, figure, methods, pages of reference."""
