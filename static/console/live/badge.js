// The look of a session's state: its colour by its tone, its shape by what it means.

/** Show `state_is` of a snapshot by the element of class "state"; null: nothing is known. */
export function badge(element, is) {
  element.dataset.tone = is?.tone ?? "neutral";
  element.toggleAttribute("data-away", is?.connected === false);
  element.toggleAttribute("data-preparing", Boolean(is?.preparing));
}
