"""How long everything takes on this machine: stages of a pair, streams, training, and how far that is from what the machine can do."""
