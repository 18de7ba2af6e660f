// Times as templates write them: in the lab's time zone, whatever the browser's is.

const timeZone = document.documentElement.dataset.zone;
const time = new Intl.DateTimeFormat("sv-SE", { timeZone, timeStyle: "medium" });
const dayAndTime = new Intl.DateTimeFormat("sv-SE", { timeZone, dateStyle: "short", timeStyle: "short" });

/** Hours, minutes and seconds of a moment: a Date, milliseconds or an ISO time. */
export function clockTime(moment) {
  return time.format(new Date(moment));
}

/** Its day, hours and minutes. */
export function when(moment) {
  return dayAndTime.format(new Date(moment));
}
