"""Reviews of episodes: what the automatic checks found, what people say of them, and which parts they mark."""
