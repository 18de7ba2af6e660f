// The panel: one question after the other for state and pictures, so that a press always has a connection of its own.
const STATE_MS = 400, PATIENCE_MS = 3000, TRIES = 3, OLD_MS = 2000;
const by = (id) => document.getElementById(id);
const page = document.documentElement.dataset;

function post(path, body) {
  return fetch(path, {
    method: "POST",
    headers: { "X-EVA-Panel": "1", "Content-Type": "application/json" },
    body: JSON.stringify(body),
    signal: AbortSignal.timeout(PATIENCE_MS),
  });
}

// crypto.randomUUID is for secure pages alone, and a press is for every page.
function uuid() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return hex.replace(/(.{8})(.{4})(.{4})(.{4})(.{12})/, "$1-$2-$3-$4-$5");
}

async function press() {
  const said = by("pressed"), which = { uuid: uuid() };
  said.textContent = "E-stop sent …";
  said.dataset.done = "";
  for (let attempt = 1; attempt <= TRIES; attempt += 1) {
    try {
      const answer = await (await post("/estop", which)).json();
      said.dataset.done = answer.done ? "yes" : "no";
      said.textContent = answer.done ? `E-stop: ${answer.text}` : answer.text;
      if (answer.done) return;
    } catch {
      said.dataset.done = "no";
      said.textContent = "USE THE HARDWARE STOP: the panel does not answer";
    }
  }
}

async function stop() {
  const said = by("stopped");
  said.textContent = "…";
  try {
    said.textContent = (await (await post("/stop", { uuid: uuid() })).json()).text;
  } catch {
    said.textContent = "the panel does not answer: use the E-STOP, or the hardware stop";
  }
}

async function enter(event) {
  event.preventDefault();
  const refused = by("refused");
  refused.textContent = "";
  try {
    const answer = await post("/pin", { pin: by("pin").value });
    if (answer.ok) {
      by("pin").value = "";
      page.entered = "yes";
      layOut();
    } else {
      refused.textContent = (await answer.json()).text;
    }
  } catch {
    refused.textContent = "the panel does not answer";
  }
}

async function leave() {
  await post("/leave", {}).catch(() => null);
  page.entered = "no";
  layOut();
}

function layOut() {
  by("seen").hidden = page.entered !== "yes";
  by("enter").hidden = page.entered === "yes" || page.pin === "unset";
  by("unset").hidden = page.entered === "yes" || page.pin !== "unset";
  if (page.entered !== "yes") by("state").textContent = "";
}

const clock = (seconds) => new Date(seconds * 1000).toLocaleTimeString();

function lab(told) {
  if (!told) return "not linked to a lab";
  if (!told.why) return `linked to ${told.lab}`;
  return told.since ? `no link to ${told.lab} since ${clock(told.since)}: ${told.why}` : `no link to ${told.lab}: ${told.why}`;
}

function run(told) {
  if (told.elapsed_s === undefined) return "none";
  return told.limit_s ? `${told.elapsed_s.toFixed(0)} of ${told.limit_s} s` : `${told.elapsed_s.toFixed(0)} s`;
}

function show(told) {
  const silent = told.silent_s > 0 || told.state === undefined;
  by("lost").hidden = !silent;
  by("lost").textContent = silent ? "No sign of life from the station: what is shown is old" : "";
  by("state").textContent = told.state ?? "unknown";
  by("state").dataset.tone = silent ? "neutral" : told.tone;
  by("reason").textContent = told.reason ?? "";
  by("run").textContent = run(told);
  by("holder").textContent = told.holder || "nobody";
  by("lab").textContent = lab(told.lab);
  by("stop").disabled = !told.stoppable;
  for (const name of Object.keys(told.cameras)) figure(name);
}

const figures = new Map();

function figure(name) {
  if (figures.has(name)) return;
  const made = document.createElement("figure"), img = document.createElement("img"), caption = document.createElement("figcaption");
  img.alt = `camera ${name}`;
  caption.textContent = name;
  made.append(img, caption);
  by("cameras").append(made);
  figures.set(name, { made, img, seen: "", at: 0 });
}

async function picture(name, shown) {
  const answer = await fetch(`/camera/${encodeURIComponent(name)}?seen=${shown.seen}`, { signal: AbortSignal.timeout(PATIENCE_MS) });
  if (answer.status === 200) {
    const address = URL.createObjectURL(await answer.blob()), before = shown.img.src;
    shown.img.src = address;
    if (before) URL.revokeObjectURL(before);
    shown.seen = answer.headers.get("X-Number");
    shown.at = performance.now();
  }
  shown.made.toggleAttribute("data-old", performance.now() - shown.at > OLD_MS);
}

async function look() {
  const answer = await fetch("/state", { signal: AbortSignal.timeout(PATIENCE_MS) });
  if (answer.status === 401) {
    page.entered = "no";
    layOut();
  } else if (answer.ok) {
    show(await answer.json());
  }
}

async function watch() {
  for (;;) {
    if (page.entered === "yes" && !document.hidden) {
      try {
        await look();
        for (const [name, shown] of figures) await picture(name, shown);
      } catch {
        by("lost").hidden = false;
        by("lost").textContent = "The panel does not answer: what is shown is old. Use the hardware stop.";
        by("state").dataset.tone = "neutral";
      }
    }
    await new Promise((done) => setTimeout(done, STATE_MS));
  }
}

by("press").addEventListener("submit", (event) => {
  event.preventDefault();
  press();
});
by("stop").addEventListener("click", stop);
by("enter").addEventListener("submit", enter);
by("leave").addEventListener("click", leave);
layOut();
watch();
