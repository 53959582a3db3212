"""The command line: parses, calls the library, formats. No physics here."""
