// A command that the station refuses while one of its processes is starting. It is sent again for a few seconds, as long as
// lease and state stay the same and the user presses nothing else.

const STARTING = "operations.family_starting"; // id of the refusal that ends by itself
const FOR_MS = 3000;
const EVERY_MS = 500;

export class Asking {
  #holds;
  #waits;
  #over = false;
  #wake = null; // ends the wait between two attempts; null if none is under way
  #refusal = null;

  /**
   * `holds()` returns whether lease and state are still those at the press; `waits(process)` is called with the process that is
   * starting.
   */
  constructor({ holds, waits }) {
    this.#holds = holds;
    this.#waits = waits;
  }

  /** Resolve to the answer of `ask()`, or to null if `end()` was called during a wait; throw the last failure. */
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
      // The timer of a tab that was frozen fires late.
      if (performance.now() > until || !this.#holds()) throw this.#refusal;
    }
  }

  /** Stop asking. Return the refusal that was not reported yet, or null if there is none. */
  end() {
    if (this.#over) return null;
    this.#over = true;
    if (!this.#wake) return null; // the answer under way will report it
    this.#wake();
    return this.#refusal;
  }
}
