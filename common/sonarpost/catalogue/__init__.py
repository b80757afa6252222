"""The shared tile database: built (Table IV), stored, identified by hash, loaded."""
