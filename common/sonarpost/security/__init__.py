"""The fleet's certificates, and who may say what to a router: X.509, Zenoh access control, checks of key files."""
