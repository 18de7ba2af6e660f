"""Web application with the database: pages, live console, trials, episodes, jobs, REST."""
