"""Web application of the console: server, access control, routes, event stream."""
