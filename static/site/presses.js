// Every way to press something: keys, buttons, touch, gamepads. For controls whose state ends with the next press of anything
// else.

/** Event on the window for a gamepad button that clicks no element of the page. */
export const PRESSED = "eva:press";

/**
 * Call `other()` on every press except clicks on elements for which `mine(element)` is true and keys that click one of them.
 * Call this after keys.js and before any other listener that clicks by keys is added: a key counts as another press if no
 * earlier listener has clicked an element of ours.
 */
export function otherPresses(mine, other) {
  let clicked = false; // true if the key that is down has clicked one of our elements
  const clicks = ({ target }) => {
    clicked = Boolean(mine(target));
    if (!clicked) other();
  };
  const begins = ({ repeat }) => repeat || (clicked = false);
  const ends = ({ key, repeat, target }) => {
    const comes = /^(Enter| )$/.test(key) && mine(target); // the browser sends the click after this event
    if (!repeat && !clicked && !comes) other();
  };
  window.addEventListener("click", clicks, { capture: true }); // runs before any listener that reports what was pressed
  window.addEventListener("keydown", begins, { capture: true });
  window.addEventListener("keydown", ends);
  window.addEventListener(PRESSED, other);
}
