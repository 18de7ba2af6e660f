// The chunk that the scene shows: drawn when it changes, animated while it is proposed, removed when no message about it comes.

import { ikText } from "./ik_text.js";
import { t } from "../../site/sentences.js";

const HEARD_MS = 2500; // the station sends a chunk each second while there is one

export class DisplayedChunk {
  #scene;
  #rate;
  #chunk = null;
  #heardAt = 0; // on this page's clock [ms]

  /** `rate()` returns how many rows are executed per second. */
  constructor(scene, rate) {
    this.#scene = scene;
    this.#rate = rate;
  }

  /** Take in the newest message of the stream `chunk`; {chunk: 0} means none. */
  take(chunk) {
    this.#heardAt = performance.now();
    const same = ["chunk", "run", "state"].every((key) => chunk[key] === this.#chunk?.[key]);
    if (!same) this.#set(chunk.chunk ? chunk : null);
  }

  /** Draw the chunk again, after it was hidden. */
  redraw() {
    this.#set(this.#chunk);
  }

  /** Remove the chunk if no message about it comes, or if the station's state is old. */
  age(fresh) {
    if (this.#chunk && (!fresh || performance.now() - this.#heardAt > HEARD_MS)) this.#set(null);
  }

  /** Describe the proposed chunk in words; "" if there is none. */
  get proposal() {
    if (this.#chunk?.state !== "proposed") return "";
    const rows = this.#chunk.targets?.length ?? 0;
    return t("page.scene3d.proposed", "chunk {chunk}, proposed: {rows} steps, {seconds} s", { chunk: this.#chunk.chunk, rows, seconds: (rows / this.#rate()).toFixed(1) });
  }

  /** Say which poses of the chunk could not be reached; "" if all were. */
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
