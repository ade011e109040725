"""Published data of others as dataset files of our own schema; `docs/import.md` says what maps to what."""
