// A sheet of paper with the positions of a scene in true size, to be laid on the bench.

import { box, drawn, escaped, n, outline, things } from "./bench.js";
import { t } from "../site/sentences.js";

const PAPERS = { A4: [297, 210], A3: [420, 297], A2: [594, 420], A1: [841, 594], A0: [1189, 841] };
const EDGE = 12; // margin that printers leave white [mm]
const HEAD = 26; // space above the drawing for title and scale [mm]
const GRID = 100;

const { title, bench, positions } = JSON.parse(document.getElementById("drawn").textContent);
const [paper, place] = ["paper", "sheet"].map((id) => document.getElementById(id));

function chosen() {
  const ticked = new Set([...document.querySelectorAll("[name=position]:checked")].map(({ value }) => Number(value)));
  return positions.filter(({ number }) => ticked.has(number));
}

/** Return the part of the bench that must be on the sheet [mm]: left, right, near, far; null if there is nothing to draw. */
function extent(rows) {
  const corners = rows.flatMap((row) => things(row.bench, bench).flatMap(outline));
  const [xs, ys] = [corners.map(([x]) => x), corners.map(([, y]) => y)];
  return corners.length ? [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)] : null;
}

function fits([width, height], [left, right, near, far]) {
  return right - left <= width - 2 * EDGE && far - near <= height - 2 * EDGE - HEAD - 8;
}

function draw() {
  const rows = chosen();
  const needed = extent(rows);
  document.getElementById("nothing").hidden = Boolean(needed);
  if (!needed) return place.replaceChildren();
  const smallest = Object.keys(PAPERS).find((name) => fits(PAPERS[name], needed)) ?? "A0";
  const name = paper.value || smallest;
  const [width, height] = PAPERS[name];
  place.dataset.paper = name;
  document.getElementById("fits").textContent = fits(PAPERS[name], needed) ? t("page.sheet.fits", "Fits on {name}.", { name }) : t("page.sheet.too_big", "Does not fit on {name}: use {smallest}.", { name, smallest });
  place.innerHTML = sheet(rows, needed, width, height);
  return place;
}

function sheet(rows, [left, right, near, far], width, height) {
  const middle = [Math.round((left + right) / 2), Math.round((near + far) / 2)];
  const view = { x: middle[0] - width / 2, y: -middle[1] - height / 2 - HEAD / 2, width, height };
  const [top, bottom] = [view.y + EDGE, view.y + height - EDGE];
  const lines = [];
  for (let x = GRID * Math.ceil((view.x + EDGE) / GRID); x <= view.x + width - EDGE; x += GRID) {
    lines.push(`<path class="ruler" d="M${n(x)} ${n(top + HEAD)}V${n(bottom)}"/><text class="ruled" x="${n(x + 1)}" y="${n(bottom)}">x ${n(x)}</text>`);
  }
  for (let y = GRID * Math.ceil(-bottom / GRID); -y >= top + HEAD; y += GRID) {
    lines.push(`<path class="ruler" d="M${n(view.x + EDGE)} ${n(-y)}H${n(view.x + width - EDGE)}"/><text class="ruled" x="${n(view.x + EDGE)}" y="${n(-y - 1)}">y ${n(y)}</text>`);
  }
  const laid = rows.flatMap((row) => things(row.bench, bench).map((thing) => drawn(thing) + tag(thing, row.number)));
  const head =
    `<text class="sheet-title" x="${n(view.x + EDGE)}" y="${n(top + 6)}">${escaped(title)}</text>` +
    `<text class="ruled" x="${n(view.x + EDGE)}" y="${n(top + 13)}">${escaped(t("page.sheet.how", "Millimetres, from above; the arms are at the lower edge. Lay the crossings of x and y on those of the bench."))}</text>` +
    `<path class="scale" d="M${n(view.x + EDGE)} ${n(top + 17)}v4h100v-4m-50 2v2"/><text class="ruled" x="${n(view.x + EDGE + 103)}" y="${n(top + 21)}">${escaped(t("page.sheet.scale", "100 mm: measure it. If it is not, print at 100 %, without fitting to the page."))}</text>`;
  return `<svg viewBox="${box(view)}" width="${width}mm" height="${height}mm" role="img" aria-label="${escaped(t("page.sheet.of", "Layout sheet of {title}", { title }))}">${lines.join("")}${laid.join("")}${head}</svg>`;
}

function tag({ name, round, x, y, yaw }, number) {
  const turn = round ? "" : ` ${n(yaw)}°`;
  return `<text class="tag" x="${n(x)}" y="${n(-y)}">${number}</text><text class="tag-small" x="${n(x)}" y="${n(-y + 5)}">${escaped(name)}${turn}</text>`;
}

document.getElementById("print").addEventListener("click", () => window.print());
document.addEventListener("change", draw);
draw();
