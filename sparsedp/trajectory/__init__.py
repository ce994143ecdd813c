"""Many steps as one node on the tape, under a memory budget."""
