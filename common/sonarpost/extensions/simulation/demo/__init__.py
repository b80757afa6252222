"""`sonarpost demo`: the whole chain on one host, from a survey file to the shore."""
