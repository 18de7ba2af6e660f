// How well the bench matches each region of the reference pictures. The server computes it, as for the gate before a run.

import { get } from "../../site/api.js";
import { t } from "../../site/sentences.js";

const LOOK_MS = 2000;
const CROP = 96; // longer side of a cut-out [px]
const LEAST = 0.75; // least match if the plan defines none; it lies between an object in its place and one that is not
const AROUND = 0.5; // margin on each side, as a share of the region's size, which shows an object that lies next to its region

/**
 * Keep the panel's list of regions and their outlines over the cameras up to date; return the set of names of cameras that have
 * regions.
 */
export function regionView() {
  const regional = new Set();
  const images = new Map(); // address of a reference -> image
  const look = async () => {
    const aid = document.getElementById("aid");
    if (aid && !document.hidden) {
      const [seen, trouble] = await asked(aid.dataset.bench);
      if (aid.isConnected) show(aid, seen, trouble, regional, images);
    } else if (!aid) {
      regional.clear();
      outline([]);
    }
    setTimeout(look, LOOK_MS);
  };
  look();
  return regional;
}

async function asked(address) {
  try {
    return [await get(address), ""];
  } catch (error) {
    return [[], error.message];
  }
}

function show(aid, seen, trouble, regional, images) {
  const least = Number(aid.dataset.least || LEAST);
  const found = seen.flatMap(({ camera, reference, regions }) => regions.map((region) => ({ camera, reference, low: region.match < least, ...region })));
  if (!trouble) {
    regional.clear();
    for (const { camera } of found) regional.add(camera);
  }
  const list = document.getElementById("aid-regions");
  const lines = trouble && regional.size ? [said(t("page.regions.trouble", "Regions cannot be compared: {trouble}", { trouble }))] : found.map((region) => line(region, images));
  list.replaceChildren(...lines);
  outline(found);
}

function said(words) {
  const item = document.createElement("li");
  item.className = "warn";
  item.textContent = words;
  return item;
}

/** Return the list item for one region: a sentence, and what reference and camera show there. */
function line(region, images) {
  const item = said(t("page.regions.line", "{camera}, {words}", { camera: region.camera, words: regionText(region) }));
  item.classList.toggle("warn", region.low);
  const pictures = document.createElement("span");
  pictures.className = "row line aid-crops";
  const live = document.querySelector(`[data-camera="${CSS.escape(region.camera)}"] canvas`);
  pictures.append(crop(imageOf(images, region.reference), region.at, t("page.regions.should_be", "as it should be")));
  if (live) pictures.append(crop(live, region.at, t("page.regions.is", "as it is")));
  item.append(pictures);
  return item;
}

/** Return a region's name, its match and where its object lies, in words. */
export function regionText({ name, match, words, low }) {
  return t("page.regions.match", "{name}: {match}, {words}", { name, match: `${match.toFixed(2)}${low ? " !" : ""}`, words });
}

/**
 * Return the part of a picture that is cut out around a region, inside the picture: [x, y, width, height] as shares of its
 * size.
 */
export function cropAround([x, y, width, height]) {
  const [left, top] = [Math.max(0, x - AROUND * width), Math.max(0, y - AROUND * height)];
  return [left, top, Math.min(1, x + (1 + AROUND) * width) - left, Math.min(1, y + (1 + AROUND) * height) - top];
}

function imageOf(images, reference) {
  if (!images.has(reference)) {
    const image = new Image();
    image.onerror = () => images.delete(reference); // load it again at the next draw
    image.src = `/pictures/${reference}.jpg`;
    images.set(reference, image);
  }
  return images.get(reference);
}

function crop(source, at, label) {
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", label);
  canvas.title = label;
  const [full, tall] = [source.naturalWidth ?? source.width, source.naturalHeight ?? source.height];
  const [x, y, width, height] = cropAround(at);
  const [wide, high] = [width * full, height * tall];
  const scale = CROP / Math.max(wide, high, 1);
  Object.assign(canvas, { width: Math.max(1, Math.round(wide * scale)), height: Math.max(1, Math.round(high * scale)) });
  if (!full) return canvas; // not loaded yet: drawn at the next update
  const paper = canvas.getContext("2d");
  paper.drawImage(source, x * full, y * tall, wide, high, 0, 0, canvas.width, canvas.height);
  paper.strokeStyle = "#ffcf6b";
  const [left, top] = [((at[0] - x) / width) * canvas.width, ((at[1] - y) / height) * canvas.height];
  paper.strokeRect(left, top, (at[2] / width) * canvas.width, (at[3] / height) * canvas.height);
  return canvas;
}

/**
 * Outline each region over its live picture: dashed if its object is not in its place, with a solid outline where the object
 * was found instead.
 */
function outline(found) {
  for (const figure of document.querySelectorAll("[data-camera]")) {
    const mine = found.filter(({ camera }) => camera === figure.dataset.camera);
    const live = figure.querySelector("canvas");
    let over = figure.querySelector("canvas.region-over");
    if (!mine.length || !live) {
      over?.remove();
      continue;
    }
    if (!over) {
      over = document.createElement("canvas");
      over.className = "region-over";
      figure.append(over);
    }
    Object.assign(over, { width: live.width, height: live.height });
    Object.assign(over.style, { left: `${live.offsetLeft}px`, top: `${live.offsetTop}px`, width: `${live.offsetWidth}px`, height: `${live.offsetHeight}px` });
    const paper = over.getContext("2d");
    for (const region of mine) drawn(paper, region, over);
  }
}

function drawn(paper, { at, dx, dy, low }, { width, height }) {
  const [x, y, wide, high] = [at[0] * width, at[1] * height, at[2] * width, at[3] * height];
  const line = Math.max(2, width / 320);
  paper.lineWidth = line;
  paper.strokeStyle = low ? "#ffcf6b" : "#7fd18b";
  paper.setLineDash(low ? [3 * line, 2 * line] : []);
  paper.strokeRect(x, y, wide, high);
  if (!low || dx === null || dy === null) return;
  paper.setLineDash([]);
  paper.strokeRect(x + dx, y + dy, wide, high);
}
