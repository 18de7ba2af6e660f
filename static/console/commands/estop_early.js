// The e-stop before the page's modules run, and where they never do: a page that looks as if it could stop the
// robot must be able to. By plain HTTP, to the web and to the process for stops at once; a classic script, because a module that fails takes all others with it.
(() => {
  const LATE_MS = 8000; // by then the modules have taken over, or something is wrong with them
  const TIMEOUT_MS = 2500;
  const area = document.getElementById("estop-area");
  const note = document.getElementById("estop-note");
  note.dataset.rest = note.innerHTML;
  const alone = () => !("ready" in area.dataset); // estop.js says when it is there

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
      headers: { "Content-Type": "text/plain" }, // which no browser asks another port about first
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
    const last = () => area.dataset.early === content.uuid; // an answer counts for the last press alone
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
    outcome.dataset.late = ""; // which estop.js takes back where it starts after all
  }, LATE_MS);
})();
