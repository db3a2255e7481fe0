"""Tell: tolerance tables for people, differences between them, and maps of the network."""
