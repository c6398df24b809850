// Elements and numbers.

// Make an element: attributes by name, `on...` for listeners; children are elements or texts, never markup.
function make(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

function draw(tag, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value);
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return element;
}

const MINUS = "\u2212";

// A number with two digits after the point and a real minus sign.
function show(value, digits = 2) {
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && Number(text) !== 0 ? MINUS + text : text;
}

// The same with a sign in any case, and a third digit for what is small.
function signed(value) {
  const text = show(value, value !== 0 && Math.abs(value) < 0.005 ? 3 : 2);
  return text.startsWith(MINUS) || Number(text) === 0 ? text : `+${text}`;
}

// As few digits as show the number.
function brief(value) {
  if (Number.isInteger(value)) return show(value, 0);
  return Math.abs(value) < 0.095 ? show(value, 3).replace(/(\.\d\d)0$/, "$1") : show(value);
}

// Names as the page writes them: arrows and underscores as a reader expects.
function pretty(name) {
  return name.replace(/->/g, "\u2192");
}

// The signs on the buttons, drawn so that no font has to have them.
const ICONS = {
  first: "M 5 4 V 16 M 16 4 L 8 10 L 16 16 Z",
  back: "M 12.5 4 L 6.5 10 L 12.5 16",
  play: "M 6 3.5 L 16 10 L 6 16.5 Z",
  pause: "M 7 4 V 16 M 13 4 V 16",
  forward: "M 7.5 4 L 13.5 10 L 7.5 16",
};

function icon(name) {
  const look = { viewBox: "0 0 20 20", class: `icon ${name}`, "aria-hidden": "true" };
  return draw("svg", look, draw("path", { d: ICONS[name] }));
}

// What makes an element work as a button for keyboard and screen readers.
function asButton(label, press) {
  return {
    role: "button",
    tabindex: 0,
    "aria-label": label,
    onclick: press,
    onkeydown: (event) => {
      if (event.key === "Enter" || event.key === " ") {
        event.preventDefault();
        event.stopPropagation();
        press(event);
      }
    },
  };
}

function counted(number, noun) {
  return `${number} ${noun}${number === 1 ? "" : "s"}`;
}
