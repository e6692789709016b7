"""Pure foundations: time, geometry, messages, topics, nodes, scenarios, faults, random streams, errors."""
