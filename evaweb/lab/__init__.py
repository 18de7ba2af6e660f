"""Complete lab on one machine: web, worker, stations and, in the demo, stand-ins for robot and policies."""
