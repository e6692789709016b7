"""How a platoon gets over the loss of each of its processes."""
