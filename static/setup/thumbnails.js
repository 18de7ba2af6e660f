// Lists of scenes: a small drawing of each position, in the same view box as the others of its scene.

import { thumbnail, windowOf } from "./bench.js";
import { t } from "../site/sentences.js";

for (const list of document.querySelectorAll("[data-drawings]")) {
  const { bench, positions } = JSON.parse(document.getElementById(list.dataset.drawings).textContent);
  const view = windowOf(positions.map((position) => position.bench), bench, 15);
  for (const [index, item] of [...list.children].entries()) {
    const { number, label, bench: laid, picture } = positions[index];
    item.insertAdjacentHTML("afterbegin", thumbnail(laid, bench, view, t("page.thumbnails.position", "Position {n} {label}", { n: number, label }).trim(), picture));
  }
}
