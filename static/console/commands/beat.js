// Sends a message every second, in a worker: a browser slows the timers of a hidden page down to one per minute.

setInterval(() => postMessage(0), 1000);
