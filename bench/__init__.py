"""Speed, by command: `python -m bench.predict` for the library, `python -m bench.serve` for the service over HTTP."""
