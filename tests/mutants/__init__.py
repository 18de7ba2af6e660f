"""Whether the suite would notice a mistake: seeded ones, and the script that tries them."""
