"""What a user adds, each in one file and with no edit to the package."""
