"""Parser of the command line, its tables of commands and examples, shell completion."""
