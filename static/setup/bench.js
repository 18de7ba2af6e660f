// A position of a bench as drawings show it: from above, in millimetres, the arms at the lower edge. Makes markup and needs no
// page.

import { t } from "../site/sentences.js";

export const ROUND = 32; // corners of a polygon that represents a circle
const STEP = 10; // step of an arrow key [mm]; 1 with Shift
const TURN = 5; // step of Page Up and Page Down [deg]; 1 with Shift
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
export const THING = t("page.bench.thing", "thing on the bench"); // what screen readers call an object that can be moved
const REACH = 2000; // bound [mm] on where the lab's own objects may lie, whatever the area is

const WORDS = { plate: t("page.bench.plate", "plate"), block: t("page.bench.block", "block") }; // other titles are the bench's own

/** Return what people call an object of the simulated bench. */
export function nameOf(key, sizes) {
  return WORDS[key] ?? sizes.objects[key].title;
}

/**
 * Return the objects on the bench of a position: [{key, name, kind, round, x, y, yaw, width, depth}], in mm and degrees. `kind`
 * is "object" for those of the lab, else the key of one of the simulated bench, of which `sizes` has sizes and, where several
 * have to be told apart, `colour` and `rim`.
 */
export function things(bench, sizes) {
  const found = [];
  for (const [key, { round, width, depth, colour, rim }] of Object.entries(sizes.objects)) {
    const place = bench?.[key];
    if (place) found.push({ key, name: nameOf(key, sizes), kind: key, round, colour, rim, yaw: round ? 0 : place[2], ...at(place), width: mm(width), depth: mm(depth) });
  }
  for (const [name, place] of Object.entries(bench?.objects ?? {}).sort(([a], [b]) => a.localeCompare(b))) {
    found.push({ key: `object ${name}`, name, kind: "object", round: false, yaw: place[2], ...at(place), width: mm(place[3]), depth: mm(place[4]) });
  }
  return found;
}

/** Return the bench with one object changed; `change` has x, y, yaw, width or depth. */
export function placed(bench, thing, change) {
  const { x, y, yaw, width, depth } = { ...thing, ...change };
  const place = [metres(x), metres(y)];
  if (thing.kind !== "object") return { ...bench, [thing.kind]: thing.round ? place : [...place, turned(yaw)] };
  return { ...bench, objects: { ...bench.objects, [thing.name]: [...place, turned(yaw), metres(width), metres(depth)] } };
}

/** Return the bench with one object changed, but kept inside the bounds for its kind. */
export function moved(bench, thing, change, sizes) {
  const { x = thing.x, y = thing.y } = change;
  const [left, right, near, far] = thing.kind === "object" ? [-REACH, REACH, -REACH, REACH] : sizes.area.map(mm);
  return placed(bench, thing, { ...change, x: Math.min(Math.max(x, left), right), y: Math.min(Math.max(y, near), far) });
}

/** Return what a key does to an object, {x, y} or {yaw}; null for a key that does nothing. */
export function stepped(thing, { key, shiftKey, ctrlKey, altKey, metaKey }) {
  if (ctrlKey || altKey || metaKey) return null;
  const [along, turns] = [ARROWS[key], { PageUp: 1, PageDown: -1 }[key]];
  const step = shiftKey ? 1 : STEP;
  if (along) return { x: thing.x + step * along[0], y: thing.y + step * along[1] };
  if (turns && !thing.round) return { yaw: thing.yaw + turns * (shiftKey ? 1 : TURN) };
  return null;
}

/** Say in words where an object lies. */
export function whereabouts({ name, round, x, y, yaw }) {
  const at = { name, x: n(x), y: n(y), yaw: n(yaw) };
  if (round) return t("page.bench.at", "{name}: x {x} mm, y {y} mm", at);
  return t("page.bench.turned", "{name}: x {x} mm, y {y} mm, turned by {yaw}°", at);
}

/** Return the bench without one of its objects. */
export function without(bench, thing) {
  const { [thing.kind]: _, ...rest } = bench;
  if (thing.kind !== "object") return rest;
  const { [thing.name]: __, ...objects } = bench.objects;
  return { ...bench, objects };
}

/** Return the corners of an object [mm]; a circle becomes a polygon of ROUND corners. */
export function outline({ round, x, y, yaw, width, depth }) {
  if (round) {
    const turns = Array.from({ length: ROUND }, (_, k) => (2 * Math.PI * k) / ROUND);
    return turns.map((turn) => [x + (width / 2) * Math.cos(turn), y + (width / 2) * Math.sin(turn)]);
  }
  const [cos, sin] = [Math.cos((yaw * Math.PI) / 180), Math.sin((yaw * Math.PI) / 180)];
  const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => [(a * width) / 2, (b * depth) / 2]);
  return corners.map(([a, b]) => [x + a * cos - b * sin, y + a * sin + b * cos]);
}

/**
 * Return sentences about objects that no simulated bench would place there, and about objects that are too close to each other.
 */
export function problems(bench, sizes) {
  const all = things(bench, sizes);
  const [left, right, near, far] = sizes.area.map(mm);
  const said = [];
  for (const { kind, name, x, y } of all) {
    if (kind !== "object" && !(x >= left && x <= right && y >= near && y <= far)) said.push(t("page.bench.outside", "{name} is outside the area that a simulated bench can lay out", { name }));
  }
  all.forEach((one, index) => {
    for (const other of all.slice(index + 1)) {
      const least = apart(one, other, sizes) ?? radius(one) + radius(other);
      const found = Math.hypot(one.x - other.x, one.y - other.y);
      if (found < least - 1e-6) said.push(t("page.bench.apart", "{one} and {other} are {apart} mm apart; at least {least} mm are needed", { one: one.name, other: other.name, apart: found.toFixed(0), least: least.toFixed(0) }));
    }
  });
  return said;
}

/** Return true if an arm of the simulated bench can grasp the object; the lab's own objects always count as reachable. */
export function reachable({ kind, x, y }, sizes) {
  return kind === "object" || sizes.sides.some((side) => Math.hypot(x - mm(side[0]), y - mm(side[1])) <= mm(sizes.reach));
}

/** Return the part that a drawing of these benches shows [mm]: {x, y, width, height}, with y downwards as in SVG. */
export function windowOf(benches, sizes, margin = 40) {
  const [left, right, near, far] = sizes.area.map(mm);
  const corners = benches.flatMap((bench) => things(bench, sizes).flatMap(outline));
  const [xs, ys] = [[left, right, ...corners.map(([x]) => x)], [near, far, ...corners.map(([, y]) => y)]];
  const [low, high] = [Math.min(...xs) - margin, Math.max(...xs) + margin];
  const [bottom, top] = [Math.min(...ys) - margin, Math.max(...ys) + margin];
  return { x: low, y: -top, width: high - low, height: top - bottom };
}

/** Return the markup of the area in which objects may lie and of the table around it, below everything else. */
export function ground(sizes, { x, y, width, height }) {
  const [left, right, near, far] = sizes.area.map(mm);
  return (
    `<rect class="table" x="${n(x)}" y="${n(y)}" width="${n(width)}" height="${n(height)}"/>` +
    `<rect class="area" x="${n(left)}" y="${n(-far)}" width="${n(right - left)}" height="${n(far - near)}"/>`
  );
}

/** Return the markup of one object; `inside` is markup that moves and turns with it. */
export function drawn(thing, { attributes = "", inside = "", words = "" } = {}) {
  const { kind, round, colour, rim, x, y, yaw, width, depth } = thing;
  const fill = colour ? ` fill="${escaped(colour)}"` : "";
  const stroke = rim ? ` stroke="${escaped(rim)}"` : "";
  const shape =
    round
      ? `<circle class="shape"${fill} r="${n(width / 2)}"/><circle class="rim"${stroke} r="${n(width / 2 - 9)}"/>`
      : `<rect class="shape"${fill} x="${n(-width / 2)}" y="${n(-depth / 2)}" width="${n(width)}" height="${n(depth)}" rx="2"/><path class="ahead" d="M0 0V${n(-depth / 2)}"/>`;
  const text = words && `<text class="thing-name" x="${n(x)}" y="${n(-y + Math.max(width, depth) / 2 + 16)}">${escaped(words)}</text>`;
  return `<g class="thing thing-${look(kind, round)}" ${attributes}><g transform="translate(${n(x)} ${n(-y)}) rotate(${n(-yaw)})">${shape}${inside}</g>${text}</g>`;
}

/**
 * Return a small picture of a bench. Without a title it is hidden from screen readers, because the text beside it says the
 * same.
 */
export function thumbnail(bench, sizes, view, title, picture = "") {
  const all = things(bench, sizes);
  const [x, y, width, height] = [view.x, view.y, view.width, view.height].map(n);
  const seen = `<image href="${escaped(picture)}" x="${x}" y="${y}" width="${width}" height="${height}" preserveAspectRatio="xMidYMid slice"/>`;
  const words = `<text class="thing-name" x="${n(view.x + view.width / 2)}" y="${n(view.y + view.height / 2)}">${escaped(t("page.bench.in_words", "in words"))}</text>`;
  const inside = all.length ? ground(sizes, view) + all.map((thing) => drawn(thing)).join("") : picture ? seen : words;
  const named = title ? `role="img" aria-label="${escaped(title)}"` : 'aria-hidden="true"';
  return `<svg class="bench-drawing" viewBox="${box(view)}" ${named}>${inside}</svg>`;
}

export function box({ x, y, width, height }) {
  return [x, y, width, height].map(n).join(" ");
}

export function escaped(text) {
  return String(text).replace(/[&<>"']/g, (sign) => `&#${sign.charCodeAt(0)};`);
}

/** Normalize an angle to -180 up to 180 degrees, in tenths. */
export function turned(yaw) {
  return Math.round((((((yaw + 180) % 360) + 360) % 360) - 180) * 10) / 10;
}

/** Format a number for markup. */
export function n(value) {
  return String(Math.round(value * 100) / 100);
}

/** Return the class of an object's look in drawings. */
export function look(kind, round) {
  return kind === "object" ? "own" : round ? "disc" : "box";
}

/** Return the least distance of two objects of the simulated bench [mm]; undefined if it declares none. */
function apart({ kind }, { kind: other }, sizes) {
  const declared = sizes.apart.find(([a, b]) => (a === kind && b === other) || (a === other && b === kind));
  return declared && mm(declared[2]);
}

function radius({ round, width, depth }) {
  return round ? width / 2 : Math.hypot(width, depth) / 2;
}

function at([x, y]) {
  return { x: mm(x), y: mm(y) };
}

function mm(value) {
  return Math.round(value * 1e6) / 1e3;
}

/** Convert mm to metres in tenths of a millimetre, so that what is shown is what is saved. */
function metres(value) {
  return Math.round(value * 10) / 1e4;
}
