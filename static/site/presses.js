// What a person presses: keys, buttons, fingers, pads. For what only the next press may go on with.

/** Told to the window of a pad's button that clicks nothing on the page. */
export const PRESSED = "eva:press";

/**
 * Have `other()` hear of every press but clicks on an element that is `mine(element)`, and keys that click one. To be called
 * after keys.js and before whatever else clicks by keys listens: a key is another one where none of them has clicked.
 */
export function otherPresses(mine, other) {
  let clicked = false; // what is ours, by the key that is down
  const clicks = ({ target }) => {
    clicked = Boolean(mine(target));
    if (!clicked) other();
  };
  const begins = ({ repeat }) => repeat || (clicked = false);
  const ends = ({ key, repeat, target }) => {
    const comes = /^(Enter| )$/.test(key) && mine(target); // its click, after this
    if (!repeat && !clicked && !comes) other();
  };
  window.addEventListener("click", clicks, { capture: true }); // before anything says what was pressed
  window.addEventListener("keydown", begins, { capture: true });
  window.addEventListener("keydown", ends);
  window.addEventListener(PRESSED, other);
}
