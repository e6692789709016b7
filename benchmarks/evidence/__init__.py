"""Does the chain of triangles converge? A seeded study of the law itself, see docs/evidence.md."""
