// Times as templates write them: in the lab's time zone, whichever zone the browser has.

const made = {};

function written(moment, style) {
  const timeZone = document.documentElement?.dataset.zone;
  made[style] ??= new Intl.DateTimeFormat("sv-SE", { timeZone, ...(style === "clock" ? { timeStyle: "medium" } : { dateStyle: "short", timeStyle: "short" }) });
  return made[style].format(new Date(moment));
}

/** Return hours, minutes and seconds of a moment: a Date, milliseconds or an ISO time. */
export function clockTime(moment) {
  return written(moment, "clock");
}

/** Return day, hours and minutes of a moment: a Date, milliseconds or an ISO time. */
export function when(moment) {
  return written(moment, "day");
}
