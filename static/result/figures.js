// Downloads of every figure: as SVG, as PNG drawn from it, and the numbers it shows as CSV.

import { t } from "../site/sentences.js";

const LOOKS = ["stroke-width", "stroke-dasharray", "font-size", "font-weight", "letter-spacing"];
const PAINTS = ["fill", "stroke"];
const FONT = "Helvetica, Arial, sans-serif";
const MARGIN = 16; // user units
const SCALE = 2;
const SVG = "http://www.w3.org/2000/svg";

/** Return what `read` finds in the light theme, which is used for print; the change is undone before anything is drawn. */
function inLight(read) {
  const { dataset } = document.documentElement;
  const { theme } = dataset;
  dataset.theme = "light";
  try {
    return read();
  } finally {
    dataset.theme = theme;
  }
}

/** Convert a colour "rgb(…)" or "color(srgb …)" into a form that every program reads: ["#rrggbb", opacity from 0 to 1]. */
function paint(colour) {
  if (colour === "none") return [colour, 1];
  const scale = colour.startsWith("color(") ? 255 : 1;
  const [red, green, blue, alpha = 1] = colour.match(/[\d.]+(?:e-\d+)?/g).map(Number);
  const parts = [red, green, blue].map((part) => Math.round(scale * part).toString(16).padStart(2, "0"));
  return [`#${parts.join("")}`, alpha];
}

/** Copy the computed style of an element to its copy, as attributes. */
function dressed(element, copy) {
  const looks = getComputedStyle(element);
  for (const name of LOOKS) copy.setAttribute(name, looks.getPropertyValue(name));
  for (const name of PAINTS) {
    const [colour, alpha] = paint(looks.getPropertyValue(name));
    copy.setAttribute(name, colour);
    copy.setAttribute(`${name}-opacity`, String(alpha * Number(looks.getPropertyValue(`${name}-opacity`))));
  }
}

/** Return a copy of the figure as text that needs no style sheet, on white and without links, with its size in user units. */
function standalone(figure) {
  const copy = figure.cloneNode(true);
  const [own, copies] = [figure, copy].map((root) => [...root.querySelectorAll("path, rect, text")]);
  inLight(() => own.forEach((element, index) => dressed(element, copies[index])));
  for (const element of copies) element.removeAttribute("class");
  for (const link of copy.querySelectorAll("a")) {
    const group = document.createElementNS(SVG, "g");
    group.replaceChildren(...link.childNodes);
    link.replaceWith(group);
  }
  const { width, height } = figure.viewBox.baseVal;
  const size = { width: width + 2 * MARGIN, height: height + 2 * MARGIN };
  const ground = document.createElementNS(SVG, "rect");
  const place = { x: -MARGIN, y: -MARGIN, ...size };
  for (const [name, value] of Object.entries({ ...place, fill: "#ffffff" })) ground.setAttribute(name, value);
  copy.querySelector("metadata").after(ground);
  copy.removeAttribute("class");
  const whole = { xmlns: SVG, ...size, viewBox: Object.values(place).join(" "), "font-family": FONT };
  for (const [name, value] of Object.entries(whole)) copy.setAttribute(name, value);
  return { text: new XMLSerializer().serializeToString(copy), ...size };
}

async function png({ text, width, height }) {
  const picture = new Image();
  picture.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  await picture.decode();
  const canvas = Object.assign(document.createElement("canvas"), { width: SCALE * width, height: SCALE * height });
  canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}

const KEPT = {
  SVG: (figure) => new Blob([standalone(figure).text], { type: "image/svg+xml" }),
  PNG: (figure) => png(standalone(figure)),
  CSV: (figure) => new Blob([figure.querySelector("metadata").textContent], { type: "text/csv" }),
};

/** Return a file name from plan and figure, such as "blocks-v1-success-rates.png". */
function named(title, kind) {
  const [, plan, version] = window.location.pathname.match(/plans\/([^/]+)\/(\d+)/) ?? [];
  const words = title.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");
  return `${plan ? `${plan}-v${version}-` : ""}${words.slice(0, 80)}.${kind.toLowerCase()}`;
}

async function keep(figure, kind) {
  const address = URL.createObjectURL(await KEPT[kind](figure));
  Object.assign(document.createElement("a"), { href: address, download: named(figure.querySelector("title").textContent, kind) }).click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}

const seen = new WeakSet();

/** Add a line of buttons below each figure that has none yet, and below the figure's caption. */
function offer() {
  for (const figure of document.querySelectorAll("svg.drawing")) {
    if (seen.has(figure)) continue;
    seen.add(figure);
    const title = figure.querySelector("title").textContent;
    const line = Object.assign(document.createElement("div"), { className: "toolbar small muted figure-keep" });
    line.setAttribute("role", "group");
    line.setAttribute("aria-label", t("page.figures.download_named", "Download: {title}", { title }));
    line.append(t("page.figures.download", "Download"));
    for (const kind of Object.keys(KEPT)) {
      const button = Object.assign(document.createElement("button"), { type: "button", className: "link", textContent: kind });
      button.addEventListener("click", () => keep(figure, kind));
      line.append(button);
    }
    const around = figure.closest("figure");
    if (around) around.append(line);
    else figure.after(line);
  }
}

offer();
document.body.addEventListener("htmx:afterSettle", offer);
