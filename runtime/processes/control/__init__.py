"""Control process, the tick: merges chunks, checks actions, sends commands; without policy and cameras."""
