"""Everything on one machine: web, worker, stations and, for the demo, stand-ins for robot and policies."""
