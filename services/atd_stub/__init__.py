"""Target detection: survey files or snippet files to contacts, released in the order of confidence."""
