// A beat each second, also of a page that is hidden: there a browser slows timers of the page itself down to one a minute.

setInterval(() => postMessage(0), 1000);
