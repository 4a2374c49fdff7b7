"""What holds, moves and loads the organ: skull, lips, contact, loose bodies, loads; and the problem they pose."""
