"""The networks that come with the project: `*.safetensors`, a card for each, and their checksums in `SHA256SUMS`."""
