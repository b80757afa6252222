// French texts; see en.js.

export default {
};
