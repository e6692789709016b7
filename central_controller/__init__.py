"""The process that guides the formation: n odometries and scans in, n commands out."""
