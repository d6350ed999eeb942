"""The engines against an integration of their own kind: the published verification of the 3-2-1 element, and more."""
