// A command that the station refuses because one of its processes is still starting: asked again for a moment, under the
// same lease and of the same state, until the person presses something else.

const STARTING = "operations.family_starting"; // the refusal that passes by itself
const FOR_MS = 3000;
const EVERY_MS = 500;

export class Asking {
  #holds;
  #waits;
  #over = false;
  #wake = null; // while it waits
  #refusal = null;

  /** `holds()`: lease and state are still those it was pressed in; `waits(process)` hears what it waits for. */
  constructor({ holds, waits }) {
    this.#holds = holds;
    this.#waits = waits;
  }

  /** The answer to `ask()`, null where it was ended while it waited; throws what it failed of last. */
  async answer(ask) {
    const until = performance.now() + FOR_MS;
    for (;;) {
      try {
        return await ask();
      } catch (error) {
        const late = performance.now() + EVERY_MS > until;
        if (error.body?.id !== STARTING || late || this.#over || !this.#holds()) throw error;
        this.#refusal = error;
      }
      this.#waits(this.#refusal.body.arguments.process);
      await new Promise((resolve) => {
        this.#wake = resolve;
        setTimeout(resolve, EVERY_MS);
      });
      this.#wake = null;
      if (this.#over) return null;
      // A timer of a tab that was frozen wakes late.
      if (performance.now() > until || !this.#holds()) throw this.#refusal;
    }
  }

  /** Ask no more; the refusal that nobody has said yet, null for none. */
  end() {
    if (this.#over) return null;
    this.#over = true;
    if (!this.#wake) return null; // the answer that is under way says it
    this.#wake();
    return this.#refusal;
  }
}
