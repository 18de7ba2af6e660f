// Presses of gamepad buttons: a button counts when it goes down while the pad is observed, never if it was held before.
// A pedal acts as a keyboard: its key can be assigned in place of a button.

import { t } from "../site/sentences.js";

/** The actions that a pad can trigger, with their default buttons (numbers of the standard mapping). */
export const ACTIONS = {
  arm: { name: t("page.pads.arm", "Arm, disarm"), button: 9 },
  big: { name: t("page.pads.big", "Start; stop and save"), button: 0 },
  discard: { name: t("page.pads.discard", "Discard"), button: 1 },
  rerecord: { name: t("page.pads.rerecord", "Re-record"), button: 3 },
  success: { name: t("page.pads.success", "Success"), button: 12 },
  partial: { name: t("page.pads.partial", "Partial"), button: 15 },
  fail: { name: t("page.pads.fail", "Fail"), button: 13 },
};

const NAMES = ["A", "B", "X", "Y", "LB", "RB", "LT", "RT", "Back", "Start", t("page.pads.left_stick", "left stick"), t("page.pads.right_stick", "right stick"), t("page.pads.up", "up"), t("page.pads.down", "down"), t("page.pads.left", "left"), t("page.pads.right", "right"), "Guide"];

/** Return a button's name on a pad of the standard mapping, else its number; a key by its name. */
export function buttonName(button, mapping) {
  if (button === null || button === undefined) return t("page.pads.none", "none");
  if (typeof button === "string") return t("page.pads.key", "key {key}", { key: button.length === 1 ? button.toUpperCase() : button });
  return mapping === "standard" && NAMES[button] ? `${NAMES[button]} (${button})` : t("page.pads.button", "button {button}", { button });
}

export function defaultMapping() {
  return Object.fromEntries(Object.entries(ACTIONS).map(([action, { button }]) => [action, button]));
}

/** Return why a key cannot be assigned to a pedal, or "" if it can; `taken` are the keys that the page uses. */
export function whyNotKey(key, taken) {
  if (key === " " || key === "Escape") return t("page.pads.is_estop", "{key} is the e-stop", { key: key === " " ? "Space" : "Esc" });
  if (/^(Tab|Shift|Control|Alt|Meta|AltGraph|CapsLock|Dead|Process|Unidentified)$/.test(key)) return t("page.pads.alone", "{key} alone cannot be assigned", { key });
  return taken.includes(key.toLowerCase()) || key === "?" ? t("page.pads.used", "the page already uses {key}", { key }) : "";
}

/** Return `mapping` with `action` on `button`, which may be a key; an action that had it before has none. */
export function withAssignment(mapping, action, button) {
  const freed = Object.entries(mapping).map(([other, at]) => [other, at === button ? null : at]);
  return { ...Object.fromEntries(freed), [action]: button };
}

/** Parse a stored mapping; use the default for every invalid part. */
export function parseMapping(text) {
  let kept = {};
  try {
    kept = JSON.parse(text ?? "{}") ?? {};
  } catch {
    kept = {};
  }
  const fits = (at) => at === null || (Number.isInteger(at) && at >= 0 && at < 64) || (typeof at === "string" && at !== "" && !whyNotKey(at, []));
  return Object.fromEntries(Object.entries(defaultMapping()).map(([action, at]) => [action, fits(kept[action]) ? kept[action] : at]));
}

/** Detects presses by comparing the pads with their previous state. */
export class Presses {
  #held = new Map(); // index -> {id, buttons}

  /** Return the buttons that went down since the last call: [{pad, button}]. A pad that is new or was exchanged has none. */
  look(pads) {
    const pressed = [];
    const there = new Set();
    for (const pad of pads) {
      if (!pad?.connected) continue;
      there.add(pad.index);
      const now = pad.buttons.map((button) => button.pressed);
      const before = this.#held.get(pad.index);
      if (before?.id === pad.id) {
        now.forEach((down, button) => down && before.buttons[button] === false && pressed.push({ pad, button }));
      }
      this.#held.set(pad.index, { id: pad.id, buttons: now });
    }
    for (const index of this.#held.keys()) if (!there.has(index)) this.#held.delete(index);
    return pressed;
  }

  /** Forget the states of all buttons, so that buttons held now count as no presses. */
  forget() {
    this.#held.clear();
  }
}
