// The position's reference picture over the live cameras, and how well the bench matches it.

import { below, correlation, grey, HEIGHT, WIDTH } from "./match.js";
import { t } from "../../site/sentences.js";

const LOOK_MS = 500;
const BLINK_MS = 500;
// How the reference is drawn over the live picture: mode -> [composite operation, opacity].
const MODES = { blend: ["source-over", 0.5], minimum: ["darken", 1], difference: ["difference", 1], blink: ["source-over", 1], edges: ["screen", 1] };

/**
 * Keep the overlays of the panel's reference pictures up to date, and show the match in the panel, except for cameras in
 * `regional`, which have regions.
 */
export function resetAid(regional) {
  const pictures = new Map(); // address -> {image, edges}
  let mode = "";
  const chosen = () => document.getElementById("aid-mode");
  document.addEventListener("change", (event) => {
    if (event.target.id !== "aid-mode") return;
    mode = event.target.value;
    look();
  });
  document.body.addEventListener("htmx:afterSettle", () => {
    if (chosen()) chosen().value = mode;
    look();
  });
  const look = () => {
    const aid = references();
    for (const figure of document.querySelectorAll("[data-camera]")) {
      const reference = aid[figure.dataset.camera];
      if (reference && !pictures.has(reference)) load(pictures, reference, look);
      cover(figure, reference && mode ? pictures.get(reference) : null, mode);
    }
    tell(aid, pictures, regional);
  };
  setInterval(look, LOOK_MS);
  look();
}

function references() {
  const element = document.getElementById("aid-pictures");
  return element ? JSON.parse(element.textContent) : {};
}

function load(pictures, address, then) {
  pictures.set(address, null);
  const image = new Image();
  image.onload = () => {
    pictures.set(address, { image, edges: edgesOf(image) });
    then();
  };
  image.onerror = () => pictures.delete(address); // load it again at the next draw
  image.src = address;
}

/** Draw the reference over the camera's picture, or remove it. The canvas below stays unchanged. */
function cover(figure, picture, mode) {
  const live = figure.querySelector("canvas");
  let over = figure.querySelector("canvas.aid-over");
  if (!picture) {
    over?.remove();
    return;
  }
  if (!over) {
    over = document.createElement("canvas");
    over.className = "aid-over";
    live.after(over);
  }
  if (over.width !== live.width || over.height !== live.height) Object.assign(over, { width: live.width, height: live.height });
  Object.assign(over.style, { left: `${live.offsetLeft}px`, top: `${live.offsetTop}px`, width: `${live.offsetWidth}px`, height: `${live.offsetHeight}px` });
  const [operation, alpha] = MODES[mode];
  const paper = over.getContext("2d");
  paper.globalCompositeOperation = "source-over";
  paper.globalAlpha = 1;
  paper.drawImage(live, 0, 0);
  if (mode === "blink" && Math.floor(performance.now() / BLINK_MS) % 2) return;
  paper.globalCompositeOperation = operation;
  paper.globalAlpha = alpha;
  paper.drawImage(mode === "edges" ? picture.edges : picture.image, 0, 0, over.width, over.height);
}

/** Show the match of each camera that has a reference, with a mark if it is below the least match. */
function tell(aid, pictures, regional) {
  const line = document.getElementById("aid-match");
  if (!line) return;
  const matches = {};
  for (const [camera, address] of Object.entries(aid)) {
    if (regional.has(camera)) continue;
    const live = document.querySelector(`[data-camera="${CSS.escape(camera)}"] canvas`);
    const picture = pictures.get(address);
    if (live && picture) matches[camera] = correlation(small(live), small(picture.image));
  }
  const least = Number(document.getElementById("aid").dataset.least || Number.NaN);
  const low = new Set(below(matches, least).map(([camera]) => camera));
  const words = Object.entries(matches).map(([camera, value]) => `${camera} ${value.toFixed(2)}${low.has(camera) ? " !" : ""}`);
  line.hidden = !words.length && regional.size > 0;
  line.textContent = matchWords(words.join(t("page.common.comma", ", ")), least);
  line.toggleAttribute("data-low", low.size > 0);
}

function matchWords(found, least) {
  if (!found) return t("page.aid.waiting", "Match: waiting for pictures");
  return Number.isFinite(least) ? t("page.aid.wanted", "Match: {found} (wanted {least})", { found, least }) : t("page.aid.match", "Match: {found}", { found });
}

function small(source) {
  const paper = new OffscreenCanvas(WIDTH, HEIGHT).getContext("2d", { willReadFrequently: true });
  paper.imageSmoothingQuality = "high";
  paper.drawImage(source, 0, 0, WIDTH, HEIGHT);
  return grey(paper.getImageData(0, 0, WIDTH, HEIGHT).data);
}

/** Return a canvas with white lines on black where the picture changes most. */
function edgesOf(image) {
  const { naturalWidth: width, naturalHeight: height } = image;
  const canvas = new OffscreenCanvas(width, height);
  const paper = canvas.getContext("2d");
  paper.drawImage(image, 0, 0);
  const data = paper.getImageData(0, 0, width, height);
  const values = grey(data.data);
  for (let y = 0; y < height; y += 1) {
    for (let x = 0; x < width; x += 1) {
      const k = y * width + x;
      const across = values[k] - values[x + 1 < width ? k + 1 : k];
      const down = values[k] - values[y + 1 < height ? k + width : k];
      const edge = Math.min(255, 6 * Math.hypot(across, down));
      data.data.set([edge, edge, edge, 255], 4 * k);
    }
  }
  paper.putImageData(data, 0, 0);
  return canvas;
}
