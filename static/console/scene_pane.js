// The pane of the 3D scene: its buttons, and a sentence in its place where it cannot be drawn.

import { get } from "../site/api.js";
import { config } from "./config.js";
import { Scene3D } from "./scene3d.js";

/** Resolves to {poses(numbers, count), bench(truth), software}; the first two do nothing where there is no scene. */
export async function scenePane() {
  const note = document.getElementById("scene-note");
  try {
    const geometry = await get(config.geometry);
    const scene = new Scene3D(document.getElementById("scene"), geometry);
    note.hidden = true;
    buttons(scene);
    return {
      poses: (numbers, count) => scene.setPoses(numbers, count),
      bench: (truth) => scene.setBench(truth),
      software: scene.software,
    };
  } catch (error) {
    note.textContent = `No 3D scene: ${error.message}. Everything else works without it.`;
    console.error(error);
    return { poses() {}, bench() {}, software: false };
  }
}

function buttons(scene) {
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => scene.view(button.dataset.view));
  }
  for (const button of document.querySelectorAll("[data-toggle]")) {
    button.addEventListener("click", () => button.setAttribute("aria-pressed", String(scene.toggle(button.dataset.toggle))));
  }
}
