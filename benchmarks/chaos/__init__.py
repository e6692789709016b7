"""Random plans of faults into one scene, and what must hold under every one of them."""
