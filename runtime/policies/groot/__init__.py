"""Parts of the GR00T protocol: its arrays, its modalities, its request, the REQ socket."""
