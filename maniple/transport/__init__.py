"""Bytes in, bytes out: the in-process network, Zenoh, and the faults put between."""
