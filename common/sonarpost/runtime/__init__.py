"""Base class and main function of a service, and the modem port."""
