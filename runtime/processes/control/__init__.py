"""Control process: each tick merges chunks, checks actions and sends commands; it uses neither policy nor cameras."""
