"""What runs a node: realtime over Zenoh or virtual time in one process."""
