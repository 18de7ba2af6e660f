"""Parts of the GR00T protocol: arrays, modalities, requests, the REQ socket."""
