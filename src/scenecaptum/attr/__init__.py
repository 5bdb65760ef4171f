"""The attribution methods and their result."""
