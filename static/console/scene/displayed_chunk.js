// The chunk that the scene shows: drawn when it changes, a film while it is proposed, gone when nothing is heard of it.

import { ikText } from "./ik_text.js";
import { t } from "../../site/sentences.js";

const HEARD_MS = 2500; // the station speaks of a chunk each second while there is one

export class DisplayedChunk {
  #scene;
  #rate;
  #chunk = null;
  #heardAt = 0; // on this page's clock [ms]

  /** `rate()` is how many rows are executed in a second. */
  constructor(scene, rate) {
    this.#scene = scene;
    this.#rate = rate;
  }

  /** The newest of stream `chunk`; {chunk: 0} where there is none. */
  take(chunk) {
    this.#heardAt = performance.now();
    const same = ["chunk", "run", "state"].every((key) => chunk[key] === this.#chunk?.[key]);
    if (!same) this.#set(chunk.chunk ? chunk : null);
  }

  /** Draw it again, after it was hidden. */
  redraw() {
    this.#set(this.#chunk);
  }

  /** Without news, or where what is known is old, nothing is shown. */
  age(fresh) {
    if (this.#chunk && (!fresh || performance.now() - this.#heardAt > HEARD_MS)) this.#set(null);
  }

  /** What is proposed, in words; "" where nothing is. */
  get proposal() {
    if (this.#chunk?.state !== "proposed") return "";
    const rows = this.#chunk.targets?.length ?? 0;
    return t("page.scene3d.proposed", "chunk {chunk}, proposed: {rows} steps, {seconds} s", { chunk: this.#chunk.chunk, rows, seconds: (rows / this.#rate()).toFixed(1) });
  }

  /** What of it could not be reached, in words; "" where all of it was. */
  get reach() {
    const { chunk, ik } = this.#chunk ?? {};
    return ik?.over ? t("page.scene3d.reach", "chunk {chunk}: {words}", { chunk, words: ikText(ik) }) : "";
  }

  #set(chunk) {
    this.#chunk = chunk;
    this.#scene.setChunk(chunk?.tips ? chunk : null);
    const film = chunk?.state === "proposed" && chunk.ghost;
    this.#scene.propose(...(film ? [chunk.ghost_rows, chunk.ghost, 1 / this.#rate()] : [[], null, 0]));
  }
}
