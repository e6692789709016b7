"""The process that stands for the physical world."""
