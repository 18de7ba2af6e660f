// The pane of the 3D scene: its buttons, the ghosts beside the robot, and a sentence if the scene cannot be drawn.

import { get, RequestFailed } from "../../site/api.js";
import { aimGhost } from "./aim_ghost.js";
import { config } from "../live/config.js";
import { Scene3D } from "./scene3d.js";
import { GHOSTS } from "./scene_ghosts.js";
import { DisplayedChunk } from "./displayed_chunk.js";
import { Tags } from "./tags.js";
import { t } from "../../site/sentences.js";

const AGAIN_MS = 3000; // wait before shapes are requested again

/**
 * Make the pane; resolve to {poses(numbers, count), bench(truth), chunk(chunk), software}, which do nothing if there is no
 * scene.
 */
export async function scenePane(store) {
  const note = document.getElementById("scene-note");
  try {
    const element = document.getElementById("scene");
    const scene = new Scene3D(element);
    const shapes = new Shapes(store, (geometry) => scene.show(geometry));
    await shapes.fetch((why) => (note.textContent = t("page.scene3d.not_yet", "No 3D scene yet: {why}. It is asked for again.", { why })));
    note.hidden = true;
    aimGhost(scene);
    const shown = new DisplayedChunk(scene, () => store.snapshot?.facts?.rate ?? store.facts.rate);
    const tags = new Tags(element.parentElement, "scene-tags");
    const name = () => nameGhosts(tags, scene, shown);
    buttons(scene, shown, name);
    store.on(["link", "open", "second"], () => {
      shown.age(store.fresh);
      name();
    });
    return {
      poses(numbers, count) {
        scene.setPoses(numbers, count);
        name();
      },
      bench: (truth) => scene.setBench(truth, store.snapshot?.facts?.bench ?? undefined),
      chunk: (chunk) => shown.take(chunk),
      software: scene.software,
    };
  } catch (error) {
    note.textContent = t("page.scene3d.none", "No 3D scene: {why}. Everything else works without it.", { why: error.message });
    console.error(error);
    return { poses() {}, bench() {}, chunk() {}, software: false };
  }
}

/** The robot's shapes, in the groups that the station reports; fetched again when it reports others. */
class Shapes {
  #store;
  #show;
  #groups = null; // groups of the last request

  constructor(store, show) {
    this.#store = store;
    this.#show = show;
  }

  /** Resolve when the shapes are drawn; `say(why)` reports why they are not yet. From then on, follow the station. */
  async fetch(say) {
    await this.#get(this.#said, say);
    this.#store.on("snapshot", () => this.#follow());
    this.#follow();
  }

  get #said() {
    return this.#store.snapshot?.facts?.groups?.join() ?? "";
  }

  async #get(groups, say) {
    this.#groups = groups;
    const geometry = await patiently(() => get(groups ? `${config.geometry}?groups=${groups}` : config.geometry), say);
    if (this.#groups !== groups) return; // the station has reported other groups meanwhile
    this.#groups = geometry.groups.join();
    this.#show(geometry);
  }

  #follow() {
    const said = this.#said;
    const complain = (why) => console.warn(`no shapes for ${said}: ${why}`);
    if (said && said !== this.#groups) this.#get(said, complain).catch((error) => complain(error.message));
  }
}

/** Resolve to the result of `ask`; retry while the web server is busy or cannot be reached, and report that through `say`. */
async function patiently(ask, say) {
  for (;;) {
    try {
      return await ask();
    } catch (error) {
      const passes = error instanceof RequestFailed && (!error.status || error.status >= 500);
      if (!passes) throw error;
      say(error.message);
      await new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    }
  }
}

/** Name in the corner which robots are drawn besides the real one. */
function nameGhosts(tags, scene, shown) {
  const words = {
    simulated: t("page.scene3d.simulated", "simulated robot; the solid one is the real robot, which receives none of this"),
    chunk: shown.proposal,
    aim: t("page.scene3d.aim", "target; nothing moves until it is sent"),
    commanded: t("page.scene3d.commanded", "commanded pose"),
  };
  for (const [ghost, { colour }] of Object.entries(GHOSTS)) tags.show(ghost, scene.draws(ghost) && words[ghost], colour);
  tags.show("reach", shown.reach, "var(--warn)");
}

function buttons(scene, shown, name) {
  for (const button of document.querySelectorAll("[data-view]")) {
    button.addEventListener("click", () => scene.view(button.dataset.view));
  }
  for (const button of document.querySelectorAll("[data-toggle]")) {
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(scene.toggle(button.dataset.toggle)));
      shown.redraw();
      name();
    });
  }
}
