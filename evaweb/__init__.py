"""Everything persistent or visible: pages, live console, trials, episodes, jobs, REST."""
