"""Faults of the layout of a displayed page."""

FAULTS = """() => {
  const name = element => {
    const more = [...element.attributes].find(one => /^data-/.test(one.name));
    const [above, own] = [element.parentElement, element].map(one =>
      one.tagName.toLowerCase() + (one.id ? `#${one.id}` : '') + [...one.classList].map(each => `.${each}`).join(''));
    return `${above} > ${own}${more ? `[${more.name}=${more.value}]` : ''}`;
  };
  const style = element => getComputedStyle(element);
  const mayScroll = (element, axis) => /auto|scroll/.test(style(element)[`overflow${axis}`]);
  const overflows = (element, axis) => (axis === 'X'
    ? element.scrollWidth > element.clientWidth + 1 : element.scrollHeight > element.clientHeight + 1);
  const found = new Set();
  const page = document.documentElement;
  if (page.scrollWidth > innerWidth || page.scrollHeight > innerHeight) found.add('the page scrolls');
  const skipped = '.skip, .sr, svg *, .leaflet-map-pane *, option, optgroup, .hidden';
  for (const element of document.body.querySelectorAll('*')) {
    if (element.closest(skipped) || !element.checkVisibility({ visibilityProperty: true })) continue;
    const box = element.getBoundingClientRect();
    if (!box.width || !box.height) continue;
    const above = [];
    for (let one = element.parentElement; one !== page; one = one.parentElement) above.push(one);
    const own = style(element);
    const isBlock = !/inline$|contents/.test(own.display);
    const text = [...element.childNodes].some(node => node.nodeType === Node.TEXT_NODE && node.textContent.trim());
    const control = element.matches('button, a, h1, h2, h3, summary, label, select');
    const clips = /hidden|clip/.test(own.overflowX);
    if (isBlock && (clips && text || control) && element.clientWidth && overflows(element, 'X')) {
      found.add(`cut off: ${name(element)}`);
    }
    const beside = !above.some(one => mayScroll(one, 'X')) && (box.left < -1 || box.right > innerWidth + 1);
    const below = !above.some(one => mayScroll(one, 'Y')) && (box.top < -1 || box.bottom > innerHeight + 1);
    if (beside || below) found.add(`outside the window: ${name(element)}`);
    const [parent] = above;
    const around = parent.getBoundingClientRect();
    if (own.position === 'static') {
      const isBox = isBlock && !/^inline$|contents/.test(style(parent).display) && !mayScroll(parent, 'X');
      if (isBox && (box.left < around.left - 1 || box.right > around.right + 1)) {
        found.add(`outside its parent: ${name(element)}`);
      }
      const cuts = /hidden|clip/.test(style(parent).overflowY) || /paint|strict|content/.test(style(parent).contain);
      if (cuts && (box.top < around.top - 1 || box.bottom > around.bottom + 1)) {
        found.add(`cut off above or below: ${name(element)}`);
      }
    }
    const isNested = axis => mayScroll(element, axis) && overflows(element, axis)
      && above.some(one => mayScroll(one, axis) && overflows(one, axis));
    if (isNested('X') || isNested('Y')) found.add(`scroll box in a scroll box: ${name(element)}`);
  }
  return [...found];
}"""
"""Returns texts with selectors: elements that are cut off, or outside their parent or the window; a scroll box in a
scroll box; a page that scrolls."""
