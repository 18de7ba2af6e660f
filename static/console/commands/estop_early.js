// The e-stop before the page's modules run, or if they never do: a page that looks as if it could stop the robot must be able
// to. It posts to the web server and to the process for stops at once. This is a classic script, because a module that fails
// takes all others with it.
(() => {
  const LATE_MS = 8000; // time [ms] after which modules that have not taken over are reported
  const TIMEOUT_MS = 2500;
  const area = document.getElementById("estop-area");
  const note = document.getElementById("estop-note");
  note.dataset.rest = note.innerHTML;
  const alone = () => !("ready" in area.dataset); // estop.js sets data-ready when it takes over

  function say(kind, text) {
    area.dataset.kind = kind;
    note.textContent = text;
  }

  function uuid() {
    const digits = Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0"));
    return digits.join("");
  }

  async function post(origin, content) {
    const answer = await fetch(origin + area.dataset.address, {
      method: "POST",
      headers: { "Content-Type": "text/plain" }, // a type that a browser sends to another port without a preflight request
      body: JSON.stringify(content),
      credentials: "include",
      redirect: "error",
      signal: AbortSignal.timeout(TIMEOUT_MS),
    });
    const { status } = await answer.json();
    if (!answer.ok || !["accepted", "done"].includes(status)) throw new Error(`HTTP ${answer.status}, ${status}`);
  }

  async function press(why) {
    const content = { uuid: uuid(), why: `${why} on the page, before it had started` };
    const last = () => area.dataset.early === content.uuid; // only the last press shows its answer
    area.dataset.early = content.uuid;
    say("pressed", "E-stop pressed …");
    try {
      await Promise.any([...new Set([area.dataset.stops, ""])].map((origin) => post(origin, content)));
      if (last()) say("stopped", "E-stop acknowledged: the robot is held.");
    } catch ({ errors }) {
      for (const error of errors) console.error(error);
      if (last()) say("failed", "USE THE HARDWARE STOP");
    }
  }

  document.getElementById("estop").addEventListener("click", () => alone() && press("button"));
  window.addEventListener("keydown", (event) => {
    if (!alone() || event.repeat || !["Escape", "Space"].includes(event.code)) return;
    event.preventDefault();
    press(event.code);
  });
  setTimeout(() => {
    if (!alone()) return;
    const outcome = document.getElementById("outcome");
    outcome.textContent = "This page has not started: reload it. Its e-stop works.";
    outcome.dataset.late = ""; // estop.js removes the message if it starts after all
  }, LATE_MS);
})();
