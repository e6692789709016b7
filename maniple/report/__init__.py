"""What a run amounts to: figures of merit from messages."""
