"""An emulated WHOI Micro-Modem and the ports on which hosts reach it."""
