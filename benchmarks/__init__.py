"""How fast it is, against what a user would write today. See README.md."""
