"""The process on every robot: dead reckoning, range sensing, the guard, the driver."""
