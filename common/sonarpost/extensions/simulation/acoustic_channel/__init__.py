"""Channel emulator service: emulated modems and the acoustic channel between them, for development and tests."""
