"""What a recording is played by: the cues, in order, and the time that each is due. Pure."""
